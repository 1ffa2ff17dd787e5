"""Shots of a real rig: trigger, cameras' pictures of one moment, clean plates, what is wrong with them."""
