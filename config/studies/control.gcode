; One programme for the control laws. The height says which part it is:
;   Z1 climb to 250   Z2 held   Z3 25 mm3/s for two seconds, then none   Z4 25 degC more
G28
M83
G1 X10 Y40 Z1 F6000
M400
M104 S250
G4 P6000
G1 Z2 F600
G4 P2000
G1 Z3 F600
M400
G1 X110 E20.789 F3000
M400
G4 P1000
G1 Z4 F600
M400
M104 S275
G4 P4000
M400
