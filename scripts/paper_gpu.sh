#!/usr/bin/env bash
# The paper's world-model arms at the paper's sizes on one GPU machine, in one call: demonstrations, world model,
# latents, wm_bc and wm_iql side by side, 300 rollouts of each, report.
#
#   scripts/paper_gpu.sh          the preset `paper`
#   scripts/paper_gpu.sh smoke    the same path in minutes on two CPU cores
#   LIMIT=540 scripts/paper_gpu.sh    stops after this many seconds, and keeps the results so far
#
# All outputs go to outputs/<preset>, a copy of the results to $OUT (default: outputs/paper_gpu/<preset>). Run it again to
# resume. PYTHON names an interpreter to use instead of .venv; it must have the project installed.
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
  echo "PyTorch finds no GPU (see above). The preset '$PRESET' takes minutes on a GPU and days without one." >&2
  exit 1
fi
mkdir -p "$OUT"

# Do not count committed records, so that everything runs on this machine.
status=0
${LIMIT:+timeout "$LIMIT"} "$PYTHON" scripts/reproduce_table1.py --preset="$PRESET" --arms=wm_bc,wm_iql --seeds=0 \
  --results_dir="$OUT/none" || status=$?

# If stopped early, there are only own_records.jsonl and the training logs.
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
if file.is_file():  # from the call that this one resumes
    seconds += json.loads(file.read_text())["wall_seconds"]
record = {**provenance(), "command": f"scripts/paper_gpu.sh {preset}", "wall_seconds": seconds}
file.write_text(json.dumps(record, indent=2) + "\n")
END
printf '%s: %d min %d s (exit code %d)\n' "$OUT" $((SECONDS / 60)) $((SECONDS % 60)) "$status"
exit "$status"
