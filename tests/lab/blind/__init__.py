"""Recordings in which an effect is hidden, for the blind test of the diagnosis.

The effects are written a second time, by other formulas than the catalogue's wherever the literature
has another form, and where there is none by another way into the recording: another tyre
on the simulated tractor, a real hill, a soil that changes.  The diagnosis sees a
configuration and channels only.
"""
