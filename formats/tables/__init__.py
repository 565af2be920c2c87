"""Tables of columns in text files, read strictly.

=================  ===============================================================================
``delimited``      text to cells and numbers; errors name file, line and column
``numbers``        plain decimal numbers
``quantities``     names of columns to quantities and SI units: ``x_mm``, ``heading [deg]``
``clocks``         times of rows, also of counters that wrap
``timestamps``     epoch seconds and ISO 8601 times to nanoseconds, exactly
=================  ===============================================================================
"""
