"""Labels every pixel of the subject as skin, hair or clothes.

In: photographs, silhouettes and the head fitted to its outlines. Out: probabilities of the parts at each pixel, for the
photometric fit, the detail and the bust.
"""
