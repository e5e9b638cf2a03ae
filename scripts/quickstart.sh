#!/usr/bin/env bash
# The whole path on one small machine: demonstrations, world model, latents, policies, rollouts, report; about 12 minutes on
# two cores. scripts/reproduce_table1.py does the same at the experiment's sizes.
#
# Training settings are in configs/quickstart/. Safe to run again: a finished stage is skipped, an interrupted one starts
# afresh (collection goes on from its finished episodes). To start from nothing, remove outputs/quickstart.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# Without bytecode files, which this variable forbids, each command spends 7 s more on its imports.
unset PYTHONDONTWRITEBYTECODE

PRESET=quickstart
ARMS=(wm_bc wm_iql)
# Variations 0-9 are those of the demonstrations: 5-14 are rolled out, five seen and five unseen. The experts need about
# 100 steps; 250 instead of 500 make failures cheaper.
FIRST_SEED=5 ROLLOUTS_PER_TASK=10 EPISODE_LENGTH=250

bash scripts/setup.sh
export HF_HUB_OFFLINE=1 MUJOCO_GL="${MUJOCO_GL:-egl}"
PATH="$PWD/.venv/bin:$PATH"

OUT="outputs/$PRESET"
DATASET=(--dataset.repo_id="local/mt6_$PRESET" --dataset.root="$OUT/dataset")
LATENTS=(--dataset.repo_id="local/mt6_${PRESET}_latents" --dataset.root="$OUT/latents")
WORLD_MODEL="$OUT/wm_rssm/checkpoints/last/pretrained_model"

# run_stage TITLE ARTEFACT COMMAND...: runs COMMAND unless the file it writes last is there already.
run_stage() {
  local title="$1" artefact="$2" start=$SECONDS
  shift 2
  if [[ -e "$artefact" ]]; then
    printf '\n== %s: done before (%s)\n' "$title" "$artefact"
    return
  fi
  printf '\n== %s\n' "$title"
  "$@"
  [[ -e "$artefact" ]] || { echo "quickstart: '$title' ended without writing $artefact" >&2; exit 1; }
  printf '== %s: %d s\n' "$title" $((SECONDS - start)) | tee -a "$OUT/times.txt"
}

# Written last in an arm's final checkpoint; an earlier checkpoint does not mean that the training is done.
checkpoint() {
  local steps
  steps=$(grep -o '"steps": *[0-9]*' "configs/$PRESET/$1.json" | grep -o '[0-9]*')
  printf '%s/checkpoints/%06d/training_state/optimizer_param_groups.json' "$OUT/$1" "$steps"
}

# LeRobot refuses to write into a folder that exists: what an interrupted stage left there goes first.
run_afresh() {
  local folder="$1"
  shift
  rm -rf "$folder"
  "$@"
}

collect() {
  lerobot-wm collect --tasks=mt6 --episodes_per_task=20 --variations=0-9 --noise=0.3 --seed=0 \
    --repo_id="local/mt6_$PRESET" --root="$OUT/dataset" --num_workers=2
}

train() {
  local arm="$1"
  shift
  run_afresh "$OUT/$arm" lerobot-wm train --config_path="configs/$PRESET/$arm.json" --seed=0 \
    --output_dir="$OUT/$arm" --job_name="$arm" "$@"
}

train_policy() {
  train "$1" --policy.world_model_path="$WORLD_MODEL" "${LATENTS[@]}"
}

encode() {
  lerobot-wm encode --world_model_path="$WORLD_MODEL" "${DATASET[@]}" \
    --output_repo_id="local/mt6_${PRESET}_latents" --output_root="$OUT/latents"
}

evaluate() {
  local arm="$1"
  # LeRobot draws a progress bar per environment step: what it says is kept beside the records.
  run_afresh "$OUT/eval_$arm" lerobot-wm eval --policy.path="$OUT/$arm/checkpoints/last/pretrained_model" \
    --env.type=metaworld_mt --env.task=mt6 --env.episode_length="$EPISODE_LENGTH" \
    --eval.n_episodes="$ROLLOUTS_PER_TASK" --seed="$FIRST_SEED" --num_workers=2 \
    --output_dir="$OUT/eval_$arm" --arm="$arm" --preset="$PRESET" --videos_per_task=2 2>"$OUT/eval_$arm.log" \
    || { tail -n 20 "$OUT/eval_$arm.log" >&2; return 1; }
}

report() {
  local evaluations logs
  evaluations=$(printf ",$OUT/eval_%s" "${ARMS[@]}")
  logs=$(printf ",$OUT/%s" wm_rssm "${ARMS[@]}")
  cat $(printf "$OUT/eval_%s/records.jsonl " "${ARMS[@]}") >"$OUT/records.jsonl"
  lerobot-wm report --records="$OUT/records.jsonl" --output_dir="$OUT/report" --videos="${evaluations:1}" \
    --train_logs="${logs:1}" --world_model_path="$WORLD_MODEL" "${DATASET[@]}" \
    --title="World-model policies on six Meta-World tasks (preset $PRESET)"
}

mkdir -p "$OUT"
lerobot-wm doctor
run_stage "Collect 120 scripted demonstrations" "$OUT/dataset/meta/collection.json" collect
run_stage "Pretrain one world model on all of them" "$(checkpoint wm_rssm)" train wm_rssm "${DATASET[@]}"
run_stage "Encode the demonstrations into latents" "$OUT/latents/meta/latents.json" encode
for arm in "${ARMS[@]}"; do
  run_stage "Train $arm" "$(checkpoint "$arm")" train_policy "$arm"
done
for arm in "${ARMS[@]}"; do
  run_stage "Roll out $arm" "$OUT/eval_$arm/records.jsonl" evaluate "$arm"
done
rm -rf "$OUT/report" # cheap, so it always shows the records that are there
run_stage "Report" "$OUT/report/index.html" report

cat <<END

Finished in $((SECONDS / 60)) min $((SECONDS % 60)) s.
  page     $PWD/$OUT/report/index.html
  table    $PWD/$OUT/report/success.md
  records  $PWD/$OUT/records.jsonl
  videos   $PWD/$OUT/eval_*/videos
END
