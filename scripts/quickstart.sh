#!/usr/bin/env bash
# The whole path on one small machine: demonstrations, world model, latents, two policies, rollouts, report.
# Safe to run again: a finished stage is skipped, an interrupted one starts afresh (collection goes on from its
# finished episodes). After a change of settings, or to start from nothing, remove outputs/quickstart.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# Without bytecode files, which this variable forbids, each command spends 7 s more on its imports.
unset PYTHONDONTWRITEBYTECODE
bash scripts/setup.sh

export HF_HUB_OFFLINE=1 MUJOCO_GL="${MUJOCO_GL:-egl}"
PATH="$PWD/.venv/bin:$PATH"

OUT=outputs/quickstart
DATASET=(--dataset.repo_id=local/mt6_quickstart --dataset.root="$OUT/dataset")
LATENTS=(--dataset.repo_id=local/mt6_quickstart_latents --dataset.root="$OUT/latents")
WORLD_MODEL="$OUT/wm_rssm/checkpoints/last/pretrained_model"
# Seeds 0-19 are variations 0-19: ten that the demonstrations show, ten that they do not.
ROLLOUTS=(--env.type=metaworld_mt --env.task=mt6 --eval.n_episodes=20 --seed=0 --num_workers=2)

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
  printf '== %s: %d s\n' "$title" $((SECONDS - start))
}

# LeRobot refuses to write into a folder that exists: what an interrupted stage left there goes first.
run_afresh() {
  local folder="$1"
  shift
  rm -rf "$folder"
  "$@"
}

collect() {
  lerobot-wm collect --tasks=mt6 --episodes_per_task=20 --variations=0-9 --noise=0.3 \
    --repo_id=local/mt6_quickstart --root="$OUT/dataset" --num_workers=2
}

train() {
  local type="$1"
  shift
  run_afresh "$OUT/$type" lerobot-wm train --policy.type="$type" --policy.push_to_hub=false \
    --output_dir="$OUT/$type" --job_name="$type" --log_freq=50 "$@"
}

encode() {
  lerobot-wm encode --world_model_path="$WORLD_MODEL" "${DATASET[@]}" \
    --output_repo_id=local/mt6_quickstart_latents --output_root="$OUT/latents"
}

evaluate() {
  local type="$1"
  run_afresh "$OUT/eval_$type" lerobot-wm eval --policy.path="$OUT/$type/checkpoints/last/pretrained_model" \
    --output_dir="$OUT/eval_$type" --arm="$type" --preset=quickstart "${ROLLOUTS[@]}"
}

report() {
  cat "$OUT"/eval_{wm_bc,wm_iql}/records.jsonl >"$OUT/records.jsonl"
  lerobot-wm report --records="$OUT/records.jsonl" --output_dir="$OUT/report" \
    --videos="$OUT/eval_wm_bc,$OUT/eval_wm_iql" --train_logs="$OUT/wm_rssm,$OUT/wm_bc,$OUT/wm_iql" \
    --world_model_path="$WORLD_MODEL" "${DATASET[@]}" --title="World-model quickstart, six Meta-World tasks"
}

lerobot-wm doctor
run_stage "Collect 120 scripted demonstrations" "$OUT/dataset/meta/collection.json" collect
run_stage "Pretrain one world model on all of them" "$OUT/wm_rssm/checkpoints/last" \
  train wm_rssm "${DATASET[@]}" --steps=600 --batch_size=16
run_stage "Encode the demonstrations into latents" "$OUT/latents/meta/latents.json" encode
run_stage "Behaviour cloning on the latents" "$OUT/wm_bc/checkpoints/last" \
  train wm_bc --policy.world_model_path="$WORLD_MODEL" "${LATENTS[@]}" --steps=3000 --batch_size=256
run_stage "Implicit Q-learning on the latents" "$OUT/wm_iql/checkpoints/last" \
  train wm_iql --policy.world_model_path="$WORLD_MODEL" "${LATENTS[@]}" --steps=3000 --batch_size=256
run_stage "Roll out the BC policy" "$OUT/eval_wm_bc/eval_info.json" evaluate wm_bc
run_stage "Roll out the IQL policy" "$OUT/eval_wm_iql/eval_info.json" evaluate wm_iql
rm -rf "$OUT/report" # cheap, so it always shows the records that are there
run_stage "Report" "$OUT/report/index.html" report

cat <<END

Finished in $((SECONDS / 60)) min $((SECONDS % 60)) s.
  page     $PWD/$OUT/report/index.html
  table    $PWD/$OUT/report/success.md
  records  $PWD/$OUT/records.jsonl
  videos   $PWD/$OUT/eval_wm_bc/videos and $PWD/$OUT/eval_wm_iql/videos
END
