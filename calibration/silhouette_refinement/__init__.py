"""Refines cameras by the outlines of the heads they photographed (Ramanathan, Steinbach and Girod 2000).

Enters: silhouettes of captures and a calibrated rig. Leaves: a refined rig, kept only if independent data confirm
it."""
