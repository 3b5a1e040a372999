#!/usr/bin/env bash
# Bakes with 1, 2 and 4 ranks, with a rank that is killed while photons are traced or texels baked, and once more after all
# were killed, or the bake was cancelled: the pages must have the same bits.
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

# The process of rank 2 of the run in a folder, once it is there.
victim_of() { # FOLDER
    for _ in $(seq 600); do
        pgrep -f "$bake_mpi $out/$1 " | while read -r pid; do
            grep -qz '^OMPI_COMM_WORLD_RANK=2$' "/proc/$pid/environ" 2>/dev/null && echo "$pid"
        done | head -1 | grep . && return
        sleep 0.02
    done
    echo 'no rank to kill' >&2
    exit 1
}

wait_for_file() { # FILE
    for _ in $(seq 3000); do
        [ -e "$1" ] && return
        sleep 0.02
    done
    echo "$1 did not come" >&2
    exit 1
}

must_be_whole() { # FOLDER
    grep -q 'rank 2 is lost' "$out/$1.txt" || { echo 'nobody noticed that a rank was lost'; cat "$out/$1.txt"; exit 1; }
    [ -e "$out/$1/page0-combined.exr" ] || { echo 'the bake was not completed'; cat "$out/$1.txt"; exit 1; }
    same whole "$1"
}

mkdir "$out/whole" "$out/lost" "$out/photons"
ranks whole 1 60

# A rank is killed while photons are traced: it is stopped before it has traced any, and dies when another one has traced
# its own. Rank 0 does its share of photons, of the radiance map and of texels.
ranks photons 3 60 &
running=$!
victim=$(victim_of photons)
# From then on it waits for the layout alone.
wait_for_file "$out/photons/scene.bkscene"
kill -STOP "$victim"
wait_for_file "$out/photons/photons-1-of-3.bkshare"
kill -9 "$victim"
[ ! -e "$out/photons/photons-2-of-3.bkshare" ] || { echo 'a stopped rank traced photons'; exit 1; }
wait $running || true
must_be_whole photons

# A rank is killed while it bakes its texels.
ranks lost 3 60 &
running=$!
victim=$(victim_of lost)
wait_for_file "$out/lost/radiance-2-of-3.bkshare"
kill -9 "$victim"
wait $running || true
must_be_whole lost
# While they waited for the rank that was lost, its part was missing.
grep -q '^texels: [1-9][0-9]* % of all ranks' "$out/lost.txt" || { echo 'no progress was printed'; cat "$out/lost.txt"; exit 1; }

# A bake is cancelled: all ranks end soon, no page is written, and the next one goes on.
mkdir "$out/cancelled"
ranks cancelled 3 60 &
running=$!
wait_for_file "$out/cancelled/photons-1-of-3.bkshare"
touch "$out/cancelled/cancel"
wait $running || true
grep -q 'cancelled; what is in the folder is kept' "$out/cancelled.txt" || { cat "$out/cancelled.txt"; exit 1; }
[ ! -e "$out/cancelled/page0-combined.exr" ] || { echo 'a cancelled bake wrote pages'; exit 1; }
rm "$out/cancelled/cancel"
ranks cancelled 3 60
same whole cancelled

# Begun anew after an interruption, a bake goes on with what is missing; a damaged share is made again.
mkdir "$out/again"
cp "$out/lost/layout.bklay" "$out/lost"/part-[01]-of-3.light "$out/lost"/photons-[01]-of-3.bkshare "$out/again/"
head -c 5000 "$out/lost/photons-2-of-3.bkshare" >"$out/again/photons-2-of-3.bkshare"
before=$(cksum <"$out/again/part-1-of-3.light"; stat -c %i "$out/again/part-1-of-3.light")
ranks again 3 60
same whole again
[ "$before" = "$(cksum <"$out/again/part-1-of-3.light"; stat -c %i "$out/again/part-1-of-3.light")" ] ||
    { echo 'a part that was there was baked again'; exit 1; }
echo 'mpi: all bits are the same'
