# The owner of a Crazyflie wants to know how good its flights are, and a corrected geometry for it.

# A flight with the Lighthouse deck; here it is simulated.
locatk simulate lighthouse --flight --receiver deck --duration 20 --seed 3 -o flight.mcap
locatk info flight.mcap

# Poses with orientation and uncertainty, compared with motion capture (here the truth).
locatk export flight.mcap --format tum -o mocap.tum
locatk solve flight.mcap -o solved.mcap --save-scene room.toml
locatk eval solved.mcap --truth mocap.tum --align se3 | tee errors.txt
grep -q 'APE' errors.txt

# The geometry goes into the drone with Bitcraze's own tools.
locatk export room.toml -o geometry.yaml && grep -q 'geos' geometry.yaml
locatk report solved.mcap -o flight.html
