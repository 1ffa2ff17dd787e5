"""Makes heads available to users by an HTTP service with pages, workers and a command line.

The package ``server`` alone imports the web framework and the job engine. For each head the service calls
``pipeline.reconstruct.reconstruct`` once.
"""
