"""The API: routes, their documents, resumable uploads; and ``serve``, which composes the service."""
