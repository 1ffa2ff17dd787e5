"""Judges whether a reconstruction result is correct and repeatable. The input is meshes and landmarks, from any
program. The output is the error figures and whether they are within limits."""
