; Hold 250 while the reading swings. The height says which part it is:  Z1 climb   Z2 held
G28
M83
G1 X10 Y40 Z1 F6000
M400
M104 S250
G4 P6000
G1 Z2 F600
G4 P20000
G1 Z3 F600
M400
