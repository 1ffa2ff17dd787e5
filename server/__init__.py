"""Makes heads available to users by an HTTP service with pages, workers and a command line.

It is the only package that imports the web framework and the job engine. For each head it calls
``pipeline.reconstruct.reconstruct`` once.
"""
