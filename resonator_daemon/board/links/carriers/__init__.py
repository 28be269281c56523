"""One file per carrier, each with one class of link targets; `links/table.py` finds them."""
