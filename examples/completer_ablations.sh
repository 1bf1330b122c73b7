#!/bin/sh
# What the completer is worth without one of its parts (docs/accuracy.md): for each `run` line below the shipped weights are
# trained some steps more without it, then judged by roll-outs on rooms that no network was trained on, two views in. Can be
# stopped and started again: finished runs and judgements stay, a begun run goes on. One core, some three minutes a run and
# two a judgement, and the rooms (320) to render once.
#   sh examples/completer_ablations.sh [FOLDER for runs and rooms, default out/completer_ablations] [STEPS, default 500]
# ROOMS (65-80) are the ones judged on. Writes docs/results/completer_ablations.md.
set -eu
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd -P)
folder=${1:-$root/out/completer_ablations}
steps=${2:-500}
program=${VDB_COMPLETE:-$root/build/release/vdb_complete}
lab=${VDB_LAB:-$root/build/release/vdb_lab}
weights=$root/weights/small
results=$root/docs/results
mkdir -p "$folder/runs" "$folder/judged" "$folder/samples"
folder=$(CDPATH='' cd -- "$folder" && pwd -P)
encoder_hash=$("$program" info --json | sed 's/.*"encoder":{[^}]*"hash":"\([^"]*\).*/\1/')

# run NAME SEED [SET...]: trains on, on the 320 rooms of before.
run() {
  name=$1-s$2 seed=$2
  shift 2
  out=$folder/runs/$name/completer.safetensors
  log=$out.work/log.csv
  if [ -f "$log" ] && [ "$(tail -n 1 "$log" | cut -d, -f1)" = "$steps" ]; then return; fi
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

# judge NAME RUN [OPTION...]: the completer of a run on the held-out rooms.
judge() {
  name=$1 run=$2
  shift 2
  if [ -s "$folder/judged/$name.jsonl" ]; then return; fi
  echo "judging $name" >&2
  "$lab" eval --scenes "rooms:${ROOMS:-65-80}" --views 2 --weights "$folder/runs/$run" --threads 1 --json "$@" \
    2>>"$folder/judged/$name.err" | grep '"method":"completed"' >"$folder/part.jsonl"
  mv "$folder/part.jsonl" "$folder/judged/$name.jsonl"
}

mkdir -p "$folder/runs/shipped"
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
judge shipped shipped
judge base,_second_seed base-s2
judge no_RoPE no_rope-s1
judge U_masked_from_the_loss unobserved_masked-s1
judge no_empty_tokens no_empty_tokens-s1
judge one_dense_stage dense_stage-s1
judge coarse_stage_only base-s1 --tau 0 --hole-tau 1 --coarse-tau .4
judge no_diffusion_in_training no_diffusion-s1
judge sampled,_10_steps base-s1 --sampling-steps 10
judge sampled,_temperature_.5 base-s1 --sampling-steps 10 --temperature .5
judge generated_context base-s1 --generated-context
judge generated_context,_random_order base-s1 --generated-context --random-order
judge generated_context,_trained_without_noise no_context_noise-s1 --generated-context

# Means over the rooms, and against the base the mean difference of F1 and PSNR with its standard error.
row() {
  awk -v name="$(echo "$1" | tr _ ' ')" '
    function value(line, key) {
      if (!match(line, "\"" key "\":-?[0-9][-+0-9.e]*")) return 0
      return substr(line, RSTART + length(key) + 3, RLENGTH - length(key) - 3) }
    /"scene":"(mean|std)"/ || /"reliability"/ { next }
    FNR == NR { base_f1[++rooms] = value($0, "f1"); base_psnr[rooms] = value($0, "psnr"); next }
    { ++n
      split("psnr ssim flip precision recall f1 outside leak seconds", keys, " ")
      for (k = 1; k in keys; ++k) sum[keys[k]] += value($0, keys[k])
      d = value($0, "f1") - base_f1[n]; f += d; ff += d * d
      d = value($0, "psnr") - base_psnr[n]; p += d; pp += d * d }
    function error(s, ss) { return n > 1 ? sqrt((ss / n - s * s / n / n) / (n - 1)) : 0 }
    END { printf "| %s | %.2f | %.3f | %.3f | %.3f | %.3f | %.3f | %.0f | %.3f | %.2f | %+.3f (%.3f) | %+.2f (%.2f) |\n", name, sum["psnr"] / n,
      sum["ssim"] / n, sum["flip"] / n, sum["precision"] / n, sum["recall"] / n, sum["f1"] / n, sum["outside"] / n, sum["leak"] / n,
      sum["seconds"] / n, f / n, error(f, ff), p / n, error(p, pp) }' "$folder/judged/base.jsonl" "$folder/judged/$1.jsonl"
}
{
  printf 'The shipped completer trained for %s steps more, two views in, rooms %s (sh examples/completer_ablations.sh).\n' "$steps" "${ROOMS:-65-80}"
  printf 'Differences to the base: mean over rooms (standard error).\n\n'
  echo '| | PSNR | SSIM | FLIP | precision | recall | F1 | outside | leak | s | F1 to base | PSNR to base |'
  echo '|---|---|---|---|---|---|---|---|---|---|---|---|'
  for name in base base,_second_seed shipped no_RoPE U_masked_from_the_loss no_empty_tokens one_dense_stage coarse_stage_only \
    no_diffusion_in_training sampled,_10_steps sampled,_temperature_.5 generated_context generated_context,_random_order \
    generated_context,_trained_without_noise; do row "$name"; done
} >"$folder/table.md"
mv "$folder/table.md" "$results/completer_ablations.md"
cat "$results/completer_ablations.md"
