"""The operator's pages at ``/``: rig, captures, features, jobs, result, calibration.

NiceGUI serves them beside the HTTP API and holds one socket to each open page. Python keeps the truth: each page is one
Vue component in ``pages/<name>.js`` that draws a ``state`` document and sends events; ``pages/<name>.py`` makes that
document from the service and answers the events, always in threads. Pictures, the live view and mesh attributes come
through routes under ``/console/`` (``media.py``), because an image element cannot send an API key.
"""
