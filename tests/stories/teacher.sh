# A teacher prints a sheet of dots for each group of a class, on the school's Letter paper, and
# wants the marks of all groups in one table.

locatk print pattern --size 8.5x11in -o sheet.pdf
head -c 5 sheet.pdf | grep -q '%PDF-'

# Each group moved its camera over the sheet; here this is simulated.
mkdir groups
for group in 1 2 3; do
    locatk simulate dots --sheet sheet.toml --frames 40 --seed $group -q -o groups/group-$group.mcap
done

# A group sent an empty file. The others are solved, and it is named.
touch groups/group-4.mcap
locatk solve groups/ -o solved/ 2> messages.txt && status=0 || status=$?
test "$status" != 0
grep -q 'group-4' messages.txt
rm groups/group-4.mcap
locatk eval solved/ --truth groups/ --table marks.csv
test "$(wc -l < marks.csv)" = 4
locatk report solved/ --truth groups/ -o class.html
