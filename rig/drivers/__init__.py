"""Drives cameras: one module for each kind, behind the interface ``base.Driver``. A vendor's library is imported only
when its driver is used."""
