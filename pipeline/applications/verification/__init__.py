"""Judges whether a result is correct, and whether it is repeatable. In: meshes and landmarks, from any program. Out:
judgements."""
