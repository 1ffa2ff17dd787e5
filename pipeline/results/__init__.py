"""What a reconstruction is, and the folder that it is written to."""
