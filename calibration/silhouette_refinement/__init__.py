"""Refines cameras with the outlines of the photographed heads (Ramanathan, Steinbach and Girod 2000).

In: silhouettes of captures and a calibrated rig. Out: a refined rig, accepted only if independent data confirm it."""
