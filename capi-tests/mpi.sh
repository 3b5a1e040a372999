#!/usr/bin/env bash
# Bakes with 1, 2 and 4 ranks, with a rank that is killed, and once more after all were killed: the pages must have the
# same bits.
#
#     capi-tests/mpi.sh BAKE_MPI FOLDER
set -euo pipefail
bake_mpi=$1 out=$2
export BAKE_MPI_STALL=2 OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe
rm -rf "$out"
mkdir -p "$out"

ranks() { # FOLDER RANKS [TEXELS_PER_UNIT]
    mpirun --oversubscribe --enable-recovery -n "$2" "$bake_mpi" "$out/$1" cornell "${3:-20}" 1 >"$out/$1.txt" 2>&1
}

bits() { (cd "$out/$1" && cat page*.exr | cksum); }

same() { # FOLDER OTHER
    [ "$(bits "$1")" = "$(bits "$2")" ] || { echo "$2 has other bits than $1"; exit 1; }
}

for n in 1 2 4; do
    mkdir "$out/$n"
    ranks $n $n
    same 1 $n
done

# A rank is killed while it bakes: rank 0 bakes its part.
mkdir "$out/whole" "$out/lost"
ranks whole 1 60
ranks lost 3 60 &
running=$!
victim=
for _ in $(seq 600); do
    if [ -e "$out/lost/layout.bklay" ]; then
        victim=$(pgrep -f "$bake_mpi $out/lost " | while read -r pid; do
            grep -qz '^OMPI_COMM_WORLD_RANK=2$' "/proc/$pid/environ" 2>/dev/null && echo "$pid"
        done | head -1) || true
        [ -n "$victim" ] && break
    fi
    sleep 0.05
done
[ -n "$victim" ] || { echo 'no rank to kill'; exit 1; }
sleep 0.2
kill -9 "$victim"
wait $running || true
[ ! -e "$out/lost/page0-combined.exr" ] || same whole lost
grep -q 'rank 2 is lost' "$out/lost.txt" || { echo 'nobody noticed that a rank was lost'; cat "$out/lost.txt"; exit 1; }
[ -e "$out/lost/page0-combined.exr" ] || { echo 'the bake was not completed'; cat "$out/lost.txt"; exit 1; }

# Begun anew after an interruption, a bake goes on with the parts that are missing.
mkdir "$out/again"
cp "$out/lost/layout.bklay" "$out/lost"/part-[01]-of-3.light "$out/again/"
before=$(cksum <"$out/again/part-1-of-3.light"; stat -c %i "$out/again/part-1-of-3.light")
ranks again 3 60
same whole again
[ "$before" = "$(cksum <"$out/again/part-1-of-3.light"; stat -c %i "$out/again/part-1-of-3.light")" ] ||
    { echo 'a part that was there was baked again'; exit 1; }
echo 'mpi: all bits are the same'
