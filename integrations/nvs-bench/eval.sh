#!/bin/bash
# nvs-bench calls this: eval.sh DATA_FOLDER OUTPUT_FOLDER. MINUTES and MAX_SPLATS change the run.
set -e
if [ $# -ne 2 ]; then
    echo "Usage: $0 <data_folder> <output_folder>"
    exit 1
fi
python "$(dirname "$0")/train_and_render.py" "$1" "$2" --minutes "${MINUTES:-30}" --max-splats "${MAX_SPLATS:-200000}"
