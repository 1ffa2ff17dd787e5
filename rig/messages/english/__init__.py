"""The English templates, a module for each area of the program; a code stands in one of them."""
