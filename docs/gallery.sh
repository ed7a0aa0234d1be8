#!/bin/sh
# Write the data of the gallery's pages, docs/gallery/*.json, from the shipped policies and from best
# known laps, which are computed if their files do not exist:   sh docs/gallery.sh [FOLDER OF LAPS]
# The searches take minutes each; their results depend a little on the speed of the machine.
set -eu
cd "$(dirname "$0")/.."
laps=${1:-runs/gallery}
pages=docs/gallery
mkdir -p "$laps" "$pages"

best() { # FILE CONFIG OPTIONS..: the flight of quadjax limit
  file=$laps/$1.npz
  shift
  [ -e "$file" ] || quadjax limit "$@" --npz "$file"
}

view() { # PAGE TITLE FLIGHTS AND OPTIONS..
  page=$pages/$1.json
  title=$2
  shift 2
  quadjax view "$@" --title "$title" --output "$page"
}

best square4 e2e +fastest --policy quadjax/pretrained/e2e_fastest.npz --seconds 200
best figure8 e2e +fastest track=figure8 --seconds 150
best figure8_indi indi +fastest track=figure8 --seconds 150
best ring8 e2e +fastest track=ring8 --seconds 150
best figure8_tudelft e2e +fastest vehicle=5inch track=figure8_tudelft --seconds 200
best grand_challenge e2e +fastest vehicle=5inch track=grand_challenge --starts 1 --seconds 200

view paper_track "E2E, INDI and the best known lap" \
  e2e_fastest e2e indi_fastest "$laps/square4.npz" --laps 3 \
  --name "E2E, time only" --name E2E --name INDI --name "best known lap"
view figure8 "Figure eight: best known laps" "$laps/figure8.npz" "$laps/figure8_indi.npz" \
  --name "E2E best known" --name "INDI best known"
view ring8 "Ring of eight gates: best known lap" "$laps/ring8.npz" --name "best known lap"
view figure8_tudelft "Figure eight of TU Delft: a 5-inch drone" \
  "$laps/figure8_tudelft.npz" --name "best known lap"
view grand_challenge "A2RL Grand Challenge: a 5-inch drone" \
  "$laps/grand_challenge.npz" --name "best known lap"

[ -e "$laps/logs" ] || quadjax logs cyberzoo --policy e2e_cyberzoo --policy indi_cyberzoo \
  --flights 1 --laps 3 --output "$laps/logs"
for name in e2e indi; do
  [ -e "$laps/$name.npz" ] || quadjax evaluate --policy "${name}_cyberzoo" --deterministic \
    --runs 1 --laps 3 --states "$laps/$name.npz"
done
view plant "E2E and INDI: simulated and on the plant cyberzoo" "$laps/e2e.npz" \
  "$laps/logs/e2e_cyberzoo_0.csv" "$laps/indi.npz" "$laps/logs/indi_cyberzoo_0.csv" \
  --logs cyberzoo --race e2e \
  --name "E2E simulated" --name "E2E plant" --name "INDI simulated" --name "INDI plant"
