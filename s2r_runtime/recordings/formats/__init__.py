"""Recordings in other people's formats as named time series: bags, flight logs, measurement files, Parquet, MATLAB."""
