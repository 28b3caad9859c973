"""Maps of a parameter study: outcomes of the model over any of its parameters, as labelled arrays.

`config` and `study` read the study, `sampling` places its cases, `outcomes` and the modules named
after it compute what is asked of a chunk of cases, `store` keeps it, `command` runs the chunks, and
`results`, `sensitivity`, `figures` and `page` show them.
"""
