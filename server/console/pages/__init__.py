"""The pages: for each a module here and a Vue component of the same name."""
