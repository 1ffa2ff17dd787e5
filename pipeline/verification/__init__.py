"""Is a result right, and does it repeat? Meshes and landmarks enter, judgements leave, whoever made the heads."""
