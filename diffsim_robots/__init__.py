"""Robots and motions that are not of the SHAC paper: tasks, grounds, and what varies between environments."""
