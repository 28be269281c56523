"""`resonatord calibrate`: known masses on a force plate, or presses on a skin, to what the plate file says."""
