#!/bin/sh
# Three trainings of one network: sh experiments/contact_estimator/run.sh CMU_PEOPLE CMU6 OUT [SEED]
set -e
common="--config-name contacts sources.cmu_people=$1 sources.cmu6=$2 training.seed=${4:-0}"
python -m egopose.train $common out="$3/ours"
python -m egopose.train $common out="$3/fixed" 'training.cameras={fixed: 1.0, pan: 0.0, zoom: 0.0, track: 0.0}'
python -m egopose.train $common out="$3/paper" training.undone=0.0
