"""Flights as interactive 3D pages: data, and self-contained HTML.

The script of the pages is ``assets/viewer.js``, which ``web/build.mjs`` bundles from ``web/src``
with three.js.
"""
