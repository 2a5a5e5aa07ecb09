#!/bin/bash
# One night: the catalog anew, then the run. Copy to /usr/local/bin/flexroad-nightly and edit the folder,
# the operator and the two commands; flexroad.cron and flexroad.service call it. Words after its name are
# options of the run. It ends with the exit code of the run, or with 2 if that could not start.
set -u
operator=operator
cd /srv/flexroad || exit 2
mkdir -p runs && exec >> runs/city.log 2>&1 || exit 2
echo "== $(date -Is)"

# Ends the night with a line in the log and a mail.
give_up() {
    echo "$1"
    echo "$1; see $PWD/runs/city.log on $(hostname)" | mail -s "FlexRoad: no run this night" "$operator"
    exit 2
}

# A run locks its folder, but the catalog must not change under the command of another night.
exec 9> runs/city.lock
flock -n 9 || give_up "the command of an earlier night is still at work"

/opt/flexroad/bin/flexroad catalog rasters survey --dsm 'dsm/*.tif' --dtm 'dtm/*.tif' --roads 'roads/*.gpkg' -o survey/catalog.parquet
# 1: files were skipped. The catalog names them, and the run does the other tiles and ends with 1, too.
(( $? <= 1 )) || give_up "the catalog could not be made"

# An address for notifications is secret: set it in the environment.
export FLEXROAD_ON_FAILURE="${FLEXROAD_ON_FAILURE:-mail -s 'FlexRoad: the night is not complete' $operator}"
# exec replaces the shell, so that flexroad receives signals.
exec /opt/flexroad/bin/flexroad run --config production --catalog survey/catalog.parquet --out runs/city "$@"
