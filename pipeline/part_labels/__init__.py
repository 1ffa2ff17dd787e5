"""Labels every pixel of the subject as skin, hair or clothes.

Enters: photographs, silhouettes and the head as its outlines give it. Leaves: a probability a pixel and part, which the
photometric fit, the detail and the bust read.
"""
