"""Trajectories in files of other programs: motion capture, ROS, evo, EuRoC and tables."""
