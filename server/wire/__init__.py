"""Receives and sends bytes over HTTP, for the API and the operator's pages: forms, files, problem documents."""
