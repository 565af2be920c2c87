# A maker logged a bar of magnetometers with an Arduino, in columns of their own, and wants to
# know which tag was passed. No locatk firmware, no TOML by hand.

locatk tag design -o tag.toml --count 4 -q > /dev/null

# The log; here it is made from a simulated pass: milliseconds, and microtesla without a unit.
locatk simulate polaris tag.toml --seed 5 -q -o pass.mcap
python - <<'PY'
import locatk

session = locatk.open("pass.mcap")
(samples,) = session.magnetometers
with open("arduino.csv", "w") as log:
    names = [f"mag{k}{axis}" for k in range(samples.field_t.shape[1]) for axis in "xyz"]
    print("millis", *names, sep=";", file=log)
    for time_ns, field_t in zip(samples.time_ns, samples.field_t):
        fields = [f"{1e6 * value:.2f}".replace(".", ",") for value in field_t.ravel()]
        print(time_ns // 1_000_000 % 2**31, *fields, sep=";", file=log)
PY
locatk import table arduino.csv --units ut --spacing 20 --tag tag.toml -o run.mcap
locatk solve run.mcap -o solved.mcap | tee solved.txt
locatk report solved.mcap -o pass.html
