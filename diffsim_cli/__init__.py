"""The command `diffsim`: it demonstrates, drives, trains, films, checks, tunes and exports."""
