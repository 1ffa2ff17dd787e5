"""Provides the live head: while somebody watches, pictures become a head, each camera's lamps, and instructions.

``live`` holds the thread and its child process, ``looking`` the child's work on one set of pictures, ``seen`` the
values that it returns, ``words`` the instructions for the subject and the operator.
"""
