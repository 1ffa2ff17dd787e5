"""Estimates a rig's cameras from pictures of a board or a scene, refines them by silhouettes, and checks them."""
