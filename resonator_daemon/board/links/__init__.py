"""Byte streams to a board over serial ports, USB and TCP; discovery and hot-plug."""
