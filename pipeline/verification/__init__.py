"""Is a result right, and does it repeat? Meshes and landmarks in, judgements out; how heads are made is not known here."""
