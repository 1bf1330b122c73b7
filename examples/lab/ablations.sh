#!/bin/sh
# The encoder-decoder's curves (docs/notes/accuracy.md): a short training for each `run` line below, its time on a few held-out
# rooms, then charts. Can be stopped and started again: finished runs stay, a begun one goes on. One core, some three
# minutes a run; the charts show what is there. The last part needs gnuplot.
#   sh examples/lab/ablations.sh [FOLDER for runs and rooms, default out/ablations] [STEPS, default 400]
# CHARTS_ONLY=1 trains nothing.
. "$(dirname -- "$0")/common.sh"
scratch "${1:-$root/out/ablations}"
steps=${2:-400}
mkdir -p "$folder/runs" "$folder/weights" "$folder/charts"

# run NAME SEED [SET...]: trains, validates on 12 held-out rooms on the way.
run() {
  if [ -n "${CHARTS_ONLY:-}" ]; then return; fi
  name=$1-s$2 seed=$2
  shift 2
  out=$folder/runs/$name.safetensors
  if finished "$out.work/log.csv" "$steps"; then return; fi
  resume=
  [ -f "$out.work/checkpoint.safetensors" ] && resume=--resume
  sets="--set latent_dim=64 --set latent_groups=1"  # base; a later --set wins
  for change in "$@"; do sets="$sets --set $change"; done
  echo "$name" >&2
  # shellcheck disable=SC2086  # one word each
  "$lab" train encoder -o "$out" --cache "$folder/rooms" --rooms 120 --steps "$steps" --rate 2e-3 --threads 1 --seed "$seed" \
    $resume $sets >"$out.txt" 2>"$out.err"
}

run base 1
run unguided 1 guide_alpha=1
run m27 1 gaussians_per_voxel=27
run dim32 1 latent_dim=32
run beta1e-2 1 kl_weight=1e-2
run unguided 2 guide_alpha=1
run base 2
run m1 1 gaussians_per_voxel=1
run fp0 1 false_positives=0
run dim16 1 latent_dim=16
run voxel20cm 1 voxel_m=0.2
run blocks1 1 blocks=1 decoder_blocks=1
run width48 1 width=48 voxel_width=24
run levels0 1 levels=0
run levels2 1 levels=2
run dim128 1 latent_dim=128
run blocks4 1 blocks=4 decoder_blocks=4
run beta1e-3 1 kl_weight=1e-3
run fp100 1 false_positives=1.0
run levels2-fp0 1 levels=2 false_positives=0
run levels2-fp100 1 levels=2 false_positives=1.0
run width192 1 width=192 voxel_width=96 heads=6
run m64 1 gaussians_per_voxel=64
run beta1e-1 1 kl_weight=1e-1
run voxel5cm 1 voxel_m=0.05
run guided-log 1 guide_log_counts=true

# Time and quality of inference, four views in, on four validation rooms (never trained on); a line NAME=FILE a run.
judged=
curves=$results/ablations.csv
echo "run,step,input_psnr,novel_psnr" >"$curves"
for weights in "$folder"/runs/*.safetensors; do
  name=$(basename "$weights" .safetensors)
  log=$weights.work/log.csv
  finished "$log" "$steps" || continue
  if [ ! -s "$weights.jsonl" ]; then
    cp "$weights" "$folder/weights/encoder.safetensors"
    for room in 900000 900001 900002 900003; do
      "$lab" eval --reconstruct --optimise 0 --views 4 --scenes "$folder/rooms/$room" --weights "$folder/weights" --threads 1 --json \
        2>>"$folder/eval.err"
    done >"$folder/part.jsonl"
    mv "$folder/part.jsonl" "$weights.jsonl"
  fi
  judged="$judged$name=$weights.jsonl
"
  # The columns by their names, which the log has in this order.
  columns=$(head -n 1 "$log" | tr , '\n' | grep -nx -e step -e input_psnr -e novel_psnr | cut -d: -f1 | paste -sd,)
  tail -n +2 "$log" | cut -d, -f"$columns" | sed "s/^/$name,/" >>"$curves"
done
compare "$judged" --method reconstructed --scores encode_seconds decode_seconds other_psnr gaussians --csv "$results/ablations_time.csv"

# psnr RUN: held-out views at the last step.
psnr() {
  last=$(grep "^$1-s1," "$curves" | tail -n 1 | cut -d, -f4)
  echo "${last:-NaN}"
}
cd "$folder/charts"
for run in base-s1 base-s2 unguided-s1 unguided-s2; do
  { grep "^$run," "$curves" || true; } | cut -d, -f2,4 | tr , ' ' >"$run"
done
printf '1 %s\n8 %s\n27 %s\n64 %s\n' "$(psnr m1)" "$(psnr base)" "$(psnr m27)" "$(psnr m64)" >m
printf '8 16\n27 22.3\n64 27.7\n125 29.5\n216 31.2\n343 31.6\n512 31.9\n' >m-paper
printf '0 %s\n.25 %s\n1 %s\n' "$(psnr fp0)" "$(psnr base)" "$(psnr fp100)" >fp8
printf '0 %s\n.25 %s\n1 %s\n' "$(psnr levels2-fp0)" "$(psnr levels2)" "$(psnr levels2-fp100)" >fp64
printf '0 28\n.1 29\n.2 30\n.3 30.8\n.35 31\n.4 31\n.5 31\n.6 29.2\n.7 27.4\n' >fp8-paper
printf '0 24\n.1 25.2\n.2 26.6\n.25 27\n.3 27\n.4 27\n.5 27\n.6 25.2\n.7 23.4\n' >fp64-paper
printf '16 %s\n32 %s\n64 %s\n128 %s\n' "$(psnr dim16)" "$(psnr dim32)" "$(psnr base)" "$(psnr dim128)" >dim
printf '1e-4 %s\n1e-3 %s\n1e-2 %s\n1e-1 %s\n' "$(psnr base)" "$(psnr beta1e-3)" "$(psnr beta1e-2)" "$(psnr beta1e-1)" >beta
{ grep -e "^configuration" -e "-s1," "$results/ablations_time.csv" || true; } | grep -v -e beta -e fp -e guided | sed "s/-s1,/,/; s/^base,/small,/" >times
printf '20 17.1\n50 22\n100 24.3\n200 25.44\n400 27.1\n600 27.5\n800 28.5\n900 29\n1000 29.5\n' >guided-paper
printf '20 16\n50 17.2\n100 21.1\n200 22.3\n400 24.2\n600 24.4\n800 24.1\n900 24.9\n1000 24.5\n' >unguided-paper
gnuplot <<'PLOT'
set terminal svg size 1350,1000 font "sans,13" background "white"
set output "charts.svg"
set multiplot layout 3,3
set grid
set datafile missing "NaN"
set style data linespoints
set key bottom right
set ylabel "PSNR, other views [dB]"
set title "Guided attention"; set xlabel "steps"
plot "base-s1" lw 2 lc 1 t "guided", "base-s2" lw 2 lc 1 dt 2 t "seed 2", "unguided-s1" lw 2 lc 2 t "learned only", "unguided-s2" lw 2 lc 2 dt 2 t "seed 2"
set title "Guided attention (paper)"; set xlabel "thousand steps"; set xtics 250
plot "guided-paper" lw 2 lc 1 t "guided", "unguided-paper" lw 2 lc 2 t "learned only"
set xtics autofreq
set key top right font ",10"
set title "Time and quality"; set xlabel "encode + decode [s], 4 views"
set datafile separator ","
set datafile columnheaders
if (int(system("wc -l <times")) > 1) {
  plot "times" using (column("encode_seconds") + column("decode_seconds")):"other_psnr" with points pt 7 notitle, \
    "" using (column("encode_seconds") + column("decode_seconds")):"other_psnr":1 with labels offset 0,.7 font ",9" notitle
} else {
  set multiplot next
}
set datafile separator whitespace
unset datafile columnheaders
set key bottom right font ",13"
set title "Gaussians a voxel"; set xlabel "M"; set logscale x
set yrange [*<18.5:19.5<*]  # seeds differ by hundredths: no magnifying glass
plot "m" lw 2 notitle
set yrange [*:*]
set title "Gaussians a voxel (paper)"
plot "m-paper" lw 2 notitle
set title "Latent channels"; set xlabel "channels"
set yrange [*<18.5:19.5<*]
plot "dim" lw 2 notitle
set yrange [*:*]
set title "KL weight"; set xlabel "beta"
plot "beta" lw 2 notitle
unset logscale x
set title "False positives"; set xlabel "share of the truth"
set yrange [*<18.5:19.5<*]
plot "fp8" lw 2 t "8x", "fp64" lw 2 t "64x"
set yrange [*:*]
set title "False positives (paper)"
plot "fp8-paper" lw 2 t "8x", "fp64-paper" lw 2 t "64x"
PLOT
cp charts.svg "$root/docs/ablations.svg"
