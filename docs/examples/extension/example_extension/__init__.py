"""An extension of resonatord: a carrier, an export format and a finding of the doctor."""
