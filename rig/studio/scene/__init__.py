"""What stands before the cameras: subject, hair, clothes, lights, backdrop, and the shot of it with its truth."""
