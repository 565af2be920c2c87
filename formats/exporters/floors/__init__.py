"""Landmark maps and sites of tags as tables, LIF layouts, drawings and maps of ROS."""
