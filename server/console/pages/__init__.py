"""Contains a module for each page; the page's Vue component has the same name."""
