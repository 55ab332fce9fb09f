"""LeRobot's dataset format, version 3: Parquet files of the frames, and videos of the pictures.

A row is a frame: ``observation.*``, ``action``, ``next.reward``, and ``info.*`` for other fields.
LeRobot's own policies need ``observation.state``, one vector, which several fields may be, or
pictures, which are videos.
"""
