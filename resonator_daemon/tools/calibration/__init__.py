"""`resonatord calibrate`: known masses on a force plate, or presses on a skin, to the record in the plate file."""
