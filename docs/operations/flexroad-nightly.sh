#!/bin/bash
# One night: the catalog anew, then the run. Copy to /usr/local/bin/flexroad-nightly and edit the folder and
# the two commands; flexroad.cron and flexroad.service call it and mail the end of its log if it fails. Words
# after its name are options of the run. It ends with the exit code of the run, or with 2 if that could not start.
set -u
cd /srv/flexroad || exit 2
mkdir -p runs && exec >> runs/city.log 2>&1 || exit 2
echo "== $(date -Is)"

# Ends the night with a line in the log.
give_up() {
    echo "$1"
    exit 2
}

# A run locks its folder, but the catalog must not change under the command of another night.
exec 9> runs/city.lock
flock -n 9 || give_up "the command of an earlier night is still at work"

/opt/flexroad/bin/flexroad catalog rasters survey --dsm 'dsm/*.tif' --dtm 'dtm/*.tif' --roads 'roads/*.gpkg' -o survey/catalog.parquet
# 1: files were skipped. The catalog names them, and the run does the other tiles and ends with 1, too.
(( $? <= 1 )) || give_up "the catalog could not be made"

# exec replaces the shell, so that flexroad receives signals.
exec /opt/flexroad/bin/flexroad run --config production --catalog survey/catalog.parquet --out runs/city "$@"
