"""Provides the operator's pages at ``/``: rig, captures, features, jobs, result, calibration and others.

NiceGUI serves them beside the HTTP API and holds one socket to each open page. Each page is a Vue component,
``pages/<name>.js``, that draws a ``state`` document and sends events. The module ``pages/<name>.py`` makes that
document from the service and answers the events, always in threads. Pictures, the live view and numbers by vertex come
through routes under ``/console/`` (``media.py``), since an image element cannot send an API key.
"""
