"""Tasks that are not of the SHAC paper."""
