"""One module and one Vue component a page."""
