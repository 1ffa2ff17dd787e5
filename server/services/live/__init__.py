"""The live head: while somebody looks, every moment's small pictures become a head, lamps of each camera, and words.

``live`` holds the thread and its child process, ``look`` what the child does with one moment's pictures, ``seen`` the
values that it hands over, ``words`` what follows from them for the subject and the operator.
"""
