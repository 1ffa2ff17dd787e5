"""Implements the HTTP API: routes, their documents, resumable uploads. ``serve`` composes the service."""
