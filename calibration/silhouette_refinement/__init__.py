"""Refines cameras with the silhouettes of the photographed heads (Ramanathan, Steinbach and Girod 2000).

A refinement takes a rig and silhouettes. The refined rig is kept only if held-out captures agree better."""
