"""Models what is in front of the cameras (subject, hair, clothes, lights, backdrop), and takes a shot of it with ground
truth."""
