"""Files of rigs, captures, pictures and meshes, ours and other programs'. Every reader names all faults at once; every
writer renames a finished file into place.
"""
