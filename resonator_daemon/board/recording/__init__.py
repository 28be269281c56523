"""Recordings of the events on a link: writer, rotation, recovery, reader."""
