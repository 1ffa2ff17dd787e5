"""Bytes in and out over HTTP, for the API and for the pages: forms, files, problem documents."""
