"""What a reconstruction is, what is measured on it, and the folder that it is written to."""
