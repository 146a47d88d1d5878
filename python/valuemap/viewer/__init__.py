"""The interactive page of a map: a server on this machine, and the page that it serves.

`scene` holds what is shown, `details` answers what a label rests on and why a place is empty, `crops` cuts pictures,
`opinions` keeps what people decide, `server` speaks HTTP and refuses whatever is not asked by its own page. The folder
`page` is built from viewer/ in the source tree.
"""
