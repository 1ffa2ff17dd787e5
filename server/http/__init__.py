"""Implements the HTTP API: routes, JSON documents of the routes, resumable uploads. ``serve`` composes the service."""
