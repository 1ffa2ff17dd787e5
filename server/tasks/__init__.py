"""Contains heavy work, and the child processes in which it runs; it does not depend on the service."""
