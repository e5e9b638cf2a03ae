#!/usr/bin/env bash
# The paper's world-model arms at the paper's sizes on one GPU machine, in one call: demonstrations, world model,
# latents, wm_bc and wm_iql side by side, 300 rollouts of each, report.
#
#   scripts/paper_gpu.sh          the preset `paper`
#   scripts/paper_gpu.sh smoke    the same path in minutes on two CPU cores
#   LIMIT=540 scripts/paper_gpu.sh    stops after so many seconds, and keeps what there is by then
#
# The work goes to outputs/<preset>, what is worth keeping to $OUT (outputs/paper_gpu/<preset> by default). Called again
# it goes on where it stopped. PYTHON names an interpreter that has the project installed, to use in place of .venv.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONDONTWRITEBYTECODE

PRESET="${1:-paper}"
OUT="${OUT:-outputs/paper_gpu/$PRESET}"
if [[ -z "${PYTHON:-}" ]]; then
  bash scripts/setup.sh
  PYTHON=.venv/bin/python
fi
if [[ "$PRESET" != smoke ]] && ! "$PYTHON" -c "import sys, torch; sys.exit(not torch.cuda.is_available())"; then
  "$PYTHON" -m lerobot_wm.cli doctor || true
  echo "PyTorch finds no GPU, on which the preset '$PRESET' takes minutes and without one days: see above." >&2
  exit 1
fi
mkdir -p "$OUT"

# Records that were committed do not count here: the machine is to do the work.
status=0
${LIMIT:+timeout "$LIMIT"} "$PYTHON" scripts/reproduce_table1.py --preset="$PRESET" --arms=wm_bc,wm_iql --seeds=0 \
  --results_dir="$OUT/none" || status=$?

# Stopped before its end, it has its own records and the logs of its trainings alone.
for file in own_records.jsonl records.jsonl times.json report/index.html report/success.md report/open_loop.png; do
  if [[ -e "outputs/$PRESET/$file" ]]; then
    cp "outputs/$PRESET/$file" "$OUT/"
  fi
done
for training in wm_rssm wm_bc wm_iql; do
  log="outputs/$PRESET/seed_0/$training/train_log.jsonl"
  if [[ -e "$log" ]]; then
    cp "$log" "$OUT/$training.jsonl"
  fi
done
"$PYTHON" - "$PRESET" "$SECONDS" "$OUT/provenance.json" <<'END'
import json
import sys
from pathlib import Path

from lerobot_wm.records import provenance

preset, seconds, file = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
if file.is_file():  # of a call that this one went on from
    seconds += json.loads(file.read_text())["wall_seconds"]
record = {**provenance(), "command": f"scripts/paper_gpu.sh {preset}", "wall_seconds": seconds}
file.write_text(json.dumps(record, indent=2) + "\n")
END
printf '%s: %d min %d s (exit code %d)\n' "$OUT" $((SECONDS / 60)) $((SECONDS % 60)) "$status"
exit "$status"
