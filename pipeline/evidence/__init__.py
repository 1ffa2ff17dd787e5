"""What is measured on a finished head and what speaks against it: by camera, by length, by plausibility."""
