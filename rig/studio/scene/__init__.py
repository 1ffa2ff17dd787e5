"""Models the subject, hair, clothes, lights and backdrop, and simulates a shot of this scene with ground truth."""
