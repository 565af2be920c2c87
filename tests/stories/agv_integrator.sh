# An AGV integrator surveyed the stations of a hall and wants magnetic tags there, with a meaning
# for each, and a check before anybody drills.

cat > survey.csv <<'CSV'
x_m;y_m;heading_deg;meaning
0,0;0,0;0;charge
1,5;0,0;0;slow
3,0;0,0;0;stop
CSV
locatk tag design -o tag.toml --count 8 -q > /dev/null
locatk site design tag.toml --points survey.csv -o hall.toml
locatk site check hall.toml
locatk info hall.toml | tee site.txt
grep -q 'stop' site.txt

# Two tags closer to each other than their magnets allow are found before they are glued.
sed 's/^3,0/1,55/' survey.csv > wrong.csv
locatk site design tag.toml --points wrong.csv -o wrong.toml && status=0 || status=$?
test "$status" = 3

# What is printed, and a drive over the hall: ids come back with their meanings.
locatk print tag hall.toml -o tags.pdf
locatk simulate polaris hall.toml --seed 2 -q -o drive.mcap
locatk solve drive.mcap --json -o solved.mcap > solved.json
python - <<'PY'
import json

detections = json.load(open("solved.json"))["sessions"][0]["detections"]
meanings = {each["tag_id"]: each["meaning"] for each in detections if each["tag_id"] is not None}
print(meanings)
assert "stop" in meanings.values(), detections
PY
locatk eval solved.mcap --truth drive.mcap
