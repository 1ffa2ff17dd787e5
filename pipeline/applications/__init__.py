"""Works on finished results and on other meshes: templates, wrapping, clinic, verification, model building.

The method imports nothing from here."""
