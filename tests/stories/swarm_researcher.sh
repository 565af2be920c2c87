# A swarm researcher has recordings of robots under Lighthouse stations, and their motion capture.
# Wanted: the errors of two methods over all recordings, as a table for the paper.

# The recordings; here they are simulated. Run 10 comes after run 2.
mkdir recordings mocap
for run in 1 2 10; do
    locatk simulate lighthouse --robots 3 --duration 10 --seed $run -q -o recordings/run-$run.mcap
done
locatk info recordings/ | tee info.txt
grep -A1 'run-2.mcap' info.txt | grep -q 'run-10.mcap'

# Motion capture, as a table of its own with the same names.
for run in 1 2 10; do
    locatk export recordings/run-$run.mcap -o mocap/run-$run.csv
done

# Both methods on all cores, each recording compared with the truth of its name.
locatk solve recordings/ -o ours/ -q
locatk solve recordings/ -o published/ --method paper -q
locatk eval ours/ published/ --truth mocap/ --table errors.tex | tee errors.txt
grep -q 'run-10' errors.txt
grep -q '\\bottomrule' errors.tex

# One page for the group, and one table of all poses for other tools.
locatk report ours/ --truth mocap/ -o swarm.html
locatk export ours/ -o poses.csv
grep -c 'run-10' poses.csv
test "$(cut -d, -f2 poses.csv | sort -u | grep -c robot)" = 3
