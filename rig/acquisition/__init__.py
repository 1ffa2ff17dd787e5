"""Takes shots with a real rig: triggers it, collects simultaneous pictures, keeps clean plates, and judges the
pictures.

Enters: rig.toml and its devices. Leaves: capture folders with sync certificates, or named faults."""
