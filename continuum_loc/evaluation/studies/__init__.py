"""
Studies behind the figures that the README quotes, one module each.

See `continuum_loc.evaluation.study`.
"""
