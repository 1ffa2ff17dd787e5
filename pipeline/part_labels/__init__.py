"""Labels every pixel of the subject as skin, hair or clothes.

The input is photographs, silhouettes and the head fitted to its outlines. The output is the probability of each label
at each pixel, for the photometric fit, the head's detail and the bust."""
