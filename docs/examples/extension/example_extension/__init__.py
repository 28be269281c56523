"""An extension of resonatord: a carrier, an export format, a finding of the doctor and a kind of sensor."""
