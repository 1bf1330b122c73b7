#!/bin/sh
# What the completer is worth without one of its parts (docs/notes/accuracy.md): for each `run` line below the shipped weights are
# trained some steps more without it, then judged by roll-outs on rooms that no network was trained on, two views in. Can be
# stopped and started again: finished runs and judgements stay, a begun run goes on. One core, some three minutes a run and
# two a judgement, and the rooms (320) to render once.
#   sh examples/lab/completer_ablations.sh [FOLDER for runs and rooms, default out/completer_ablations] [STEPS, default 500]
# ROOMS (65-80) are the ones judged on. Writes docs/results/completer_ablations.md.
. "$(dirname -- "$0")/common.sh"
scratch "${1:-$root/out/completer_ablations}"
steps=${2:-500}
rooms=${ROOMS:-65-80}
weights=$root/weights/indoor
mkdir -p "$folder/runs/shipped" "$folder/judged" "$folder/samples"
encoder_hash=$("$program" info --json | sed 's/.*"encoder":{[^}]*"hash":"\([^"]*\).*/\1/')

# run NAME SEED [SET...]: trains on, on the 320 rooms of before.
run() {
  name=$1-s$2 seed=$2
  shift 2
  out=$folder/runs/$name/completer.safetensors
  if finished "$out.work/log.csv" "$steps"; then return; fi
  mkdir -p "$out.work"
  ln -sfn "$folder/samples" "$out.work/samples_$encoder_hash"  # encoded once
  ln -sfn "$weights/encoder.safetensors" "$folder/runs/$name/encoder.safetensors"
  start="--from $weights/completer.safetensors" sets=
  [ -f "$out.work/checkpoint.safetensors" ] && start=--resume
  for change in "$@"; do sets="$sets --set $change"; done
  echo "$name" >&2
  # shellcheck disable=SC2086  # one word each
  "$lab" train mar --encoder "$weights/encoder.safetensors" -o "$out" --cache "$folder/rooms" --rooms 320 --steps "$steps" \
    --rate 4e-4 --threads 1 --seed "$seed" $start $sets >"$out.txt" 2>"$out.err"
}

# judge NAME RUN [OPTION...]: the completer of a run on the held-out rooms; adds a line NAME=FILE to `judged`.
judged=
judge() {
  name=$1 run=$2
  shift 2
  judged="$judged$name=$folder/judged/$name.jsonl
"
  evaluate "$folder/judged/$name.jsonl" --scenes "rooms:$rooms" --views 2 --weights "$folder/runs/$run" "$@"
}

for file in encoder completer; do ln -sfn "$weights/$file.safetensors" "$folder/runs/shipped/$file.safetensors"; done
run base 1
run no_rope 1 rotary_positions=false
run unobserved_masked 1 unobserved_weight=0
run no_empty_tokens 1 empty_tokens=0 coarse_empty_tokens=0
run base 2
run no_diffusion 1 diffusion_draws=0
run no_context_noise 1 context_noise=0 context_false_positives=0
run dense_stage 1 coarse_stage=false

judge base base-s1
judge 'base, second seed' base-s2
judge shipped shipped
judge 'no RoPE' no_rope-s1
judge 'U masked from the loss' unobserved_masked-s1
judge 'no empty tokens' no_empty_tokens-s1
judge 'one dense stage' dense_stage-s1
judge 'coarse stage only' base-s1 --tau 0 --hole-tau 1 --coarse-tau .4
judge 'no diffusion in training' no_diffusion-s1
judge 'sampled, 10 steps' base-s1 --sampling-steps 10
judge 'sampled, temperature .5' base-s1 --sampling-steps 10 --temperature .5
judge 'generated context' base-s1 --generated-context
judge 'generated context, random order' base-s1 --generated-context --random-order
judge 'generated context, trained without noise' no_context_noise-s1 --generated-context

{
  printf 'The shipped completer trained for %s steps more, two views in, rooms %s (sh examples/lab/completer_ablations.sh).\n' "$steps" "$rooms"
  printf 'Differences to the base: mean over rooms (standard error).\n\n'
  compare "$judged" --method completed --scores psnr ssim flip precision recall f1 outside leak seconds
} >"$folder/table.md"
mv "$folder/table.md" "$results/completer_ablations.md"
cat "$results/completer_ablations.md"
