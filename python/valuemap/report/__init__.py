"""Pictures, tables and pages that show a map and how far it can be trusted.

`above` draws a map from above, `write` makes the whole report, `label_sheet` shows one label, `place_sheet` one place.
"""
