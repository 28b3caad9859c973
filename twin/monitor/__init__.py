"""`shaketwin monitor`: terminal display of a running test.

`run_state` is the state of the run as received, `recent` its last seconds, `expected_end` when it
will end; `run_view` is what is shown of it. `panels` and `screen` lay it out on a terminal; `app`
connects bus, terminal and keyboard. `page_data` writes it as JSON, `page_server` serves it with the
files in `page/`; `web` connects bus and server.
"""
