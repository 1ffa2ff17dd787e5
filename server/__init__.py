"""Makes heads available to users: HTTP service with its pages, workers, command line.

It is the only package that imports the web framework and the job engine. Everything that it does for a head is one call
of ``pipeline.reconstruct.reconstruct``.
"""
