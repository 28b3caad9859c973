"""`shaketwin monitor`: terminal display of a running test.

`run_state` is the state of the run as received, `recent` its last second, `margins` the margins
to the limits; `panels` and `screen` draw them; `app` connects bus, terminal and keyboard.
`page_data` writes them as JSON, `page_server` serves them with the files in `page/`; `web` connects
bus and server.
"""
