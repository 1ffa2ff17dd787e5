"""The front doors: HTTP service, workers, command line. The only package that knows of the web framework and of the
job engine; everything it does for a head is one call of ``pipeline.reconstruct.reconstruct``.
"""
