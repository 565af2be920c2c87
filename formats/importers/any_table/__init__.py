"""Tables of any layout, whose columns are recognised by their names or named by the user.

===================  ==========================================================================
``columns``          keys of columns and the usual names by which they are recognised
``mapping``          file that names columns, units and clock
``magnetometers``    samples of magnetometers, and odometry
``sweeps``           sweeps of Lighthouse base stations
``inertial``         samples of accelerometers and gyroscopes
===================  ==========================================================================
"""
