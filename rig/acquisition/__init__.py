"""Takes shots with a real rig: triggers it, collects simultaneous pictures, stores clean plates, and judges the
pictures.

In: rig.toml and its devices. Out: capture folders with sync certificates, or named faults."""
