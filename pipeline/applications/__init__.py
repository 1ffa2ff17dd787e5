"""Works on finished results and on other meshes: templates, wrapping, clinic, verification, model building.

Nothing of the method imports it."""
