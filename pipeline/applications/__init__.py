"""Works on finished results and on other meshes: templates, wrapping, clinic, verification, model building.

The reconstruction method imports nothing from this package."""
