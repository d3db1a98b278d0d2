"""
Hypothesis draws the same examples in every run, so that no chance breaks a test.

Only a change does. To search anew: HYPOTHESIS_PROFILE=explore make test.
"""

import os

from hypothesis import settings

settings.register_profile('same', derandomize=True)
settings.register_profile('explore')
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'same'))
