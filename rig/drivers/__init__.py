"""One module a kind of camera, behind ``base.Driver``; a vendor's library is imported on use, inside its driver."""
