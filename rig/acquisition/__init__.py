"""Takes shots with a camera rig: triggers the cameras, collects their simultaneous pictures, and judges these.

The input is rig.toml and the devices that it lists. The output is capture folders, or faults with remedies."""
