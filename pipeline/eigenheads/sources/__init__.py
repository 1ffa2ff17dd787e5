"""Where models come from: MakeHuman's population, other programs' files, downloads."""
