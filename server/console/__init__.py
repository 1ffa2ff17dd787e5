"""Provides the operator's pages at ``/``: rig, captures, features, jobs, result, calibration and others.

NiceGUI serves the pages beside the HTTP API and holds one socket to each open page. Each page is a Vue component,
``pages/<name>.js``, that draws a ``state`` document and sends events. The module ``pages/<name>.py`` makes the
``state`` document from the service and answers a page's events, always in threads. Pictures, the live view and values
for each vertex come through routes under ``/console/`` (``media.py``), since an image element sends no API key.
"""
