"""Statics of a rod with tendons: what shape follows from how far or how hard they are pulled."""
