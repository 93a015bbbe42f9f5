"""Rows of MuJoCo's constraints between two bodies: equality and contact of geoms."""
