"""Labels every pixel of the subject as skin, hair or clothes.

Enters: photographs, silhouettes and the head fitted to its outlines. Leaves: probabilities of the parts at each pixel,
which the photometric fit, the detail and the bust read.
"""
