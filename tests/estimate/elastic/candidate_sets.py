"""The sensor sets that Karason, Srinivasan and Annaswamy compare in their section 3.1."""

CANDIDATES = {
    "a": ("xy", "xx", "yy"),
    "b": ("xx", "yy", "zz"),
    "c": ("zz", "xz", "yz"),
    "d": ("xy", "xz", "yz"),
    "e": ("p_n", "zz", "xy"),
    "f": ("p_n", "xx", "yy"),
    "g": ("p_n", "xz", "yz"),
}
