"""Takes shots with a camera rig: triggers the cameras, collects and judges their simultaneous pictures.

The input is rig.toml and the devices that it lists. The output is capture folders, or faults with remedies."""
