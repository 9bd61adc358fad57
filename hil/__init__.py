"""Hardware in the loop: the onboard side.

Uses ``camera`` and the onboard-safe modules of ``visthrow``, never ``sim``.
"""
