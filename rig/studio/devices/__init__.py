"""Makes the simulated studio available as camera streams, as a trigger box on a serial line, and as files."""
