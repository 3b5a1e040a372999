#!/usr/bin/env bash
# Runs the viewer without a screen (Xvfb, OpenGL in software) on a small room: it must end well, refine the
# light, switch it, and write pictures that are not black, lit by baked direct light or by shadow maps.
#
#     test.sh VIEWER
set -euo pipefail
viewer=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"

# A room of 4 x 3 x 4 metres with a box on the floor, seen from inside.
cat >room.obj <<'OBJ'
mtllib room.mtl
v -2 0 -2
v 2 0 -2
v 2 0 2
v -2 0 2
v -2 3 -2
v 2 3 -2
v 2 3 2
v -2 3 2
v -0.5 0 -0.5
v 0.5 0 -0.5
v 0.5 0 0.5
v -0.5 0 0.5
v -0.5 1 -0.5
v 0.5 1 -0.5
v 0.5 1 0.5
v -0.5 1 0.5
usemtl white
f 1 4 3 2
f 5 6 7 8
f 1 2 6 5
f 3 4 8 7
usemtl red
f 4 1 5 8
f 2 3 7 6
usemtl white
f 13 16 15 14
f -8 -4 -3 -7
f 10 14 15 11
f 11 15 16 12
f 12 16 13 9
OBJ
cat >room.mtl <<'MTL'
newmtl white
Kd 0.8 0.8 0.8
newmtl red
Kd 0.8 0.1 0.1
MTL
printf '0 -1.5 2 1.5 0 0.5 0\n1 1.5 2 1.5 0 0.5 0\n' >path

fail() {
    echo "viewer: $1" >&2
    exit 1
}

# mean PNG: the mean byte of its pixels, which the viewer writes uncompressed behind 50 bytes of headers.
mean() {
    tail -c +51 "$1" | od -An -v -tu1 |
        awk '{ for (i = 1; i <= NF; i++) sum += $i; n += NF } END { print int(sum / n) }'
}

# look NAME FRAMES OPTIONS: with pictures of the first frame and the last.
look() {
    mkdir "$1"
    xvfb-run -a -s '-screen 0 640x480x24' "$viewer" room.obj --light point:1,2.5,1:10,10,10 --texels-per-unit 16 \
        --page-size 256 --width 160 --height 120 --no-overlay --headless --frames "$2" --path path \
        --screenshot-every $(($2 - 1)) --csv "$1/frames.csv" --out "$1" --budget-ms 20 --check "${@:3}" || fail "$1: exit code $?"
    [ "$(wc -l <"$1/frames.csv")" = $(($2 + 1)) ] || fail "$1: the CSV has $(wc -l <"$1/frames.csv") lines"
    [ "$(mean "$1/frame00000.png")" -ge 40 ] || fail "$1: the first picture is dark: $(mean "$1/frame00000.png")"
}

look view 31
look position 31 --mode position --heat-map
look shadow-maps 31 --mode off --shadow-maps
# Indirect light goes when the library has computed that there is none, on a thread of its own.
look dark 501 --switch-light-at 5

rays() { awk -F, 'NR > 1 { rays += $8 } END { print rays + 0 }' "$1/frames.csv"; }
[ "$(rays view)" -gt 0 ] || fail 'the view-based updates traced nothing'
[ "$(rays position)" -gt 0 ] || fail 'the position-based updates traced nothing'
[ "$(rays shadow-maps)" -eq 0 ] || fail "off traced $(rays shadow-maps) rays"
[ "$(mean view/frame00030.png)" -ge 40 ] || fail 'the last picture is dark'
[ "$(mean dark/frame00500.png)" -lt 20 ] || fail "with its light off the room shows $(mean dark/frame00500.png)"
difference=$(($(mean view/frame00000.png) - $(mean shadow-maps/frame00000.png)))
[ "${difference#-}" -le 4 ] || fail "baked direct light and that of shadow maps differ by $difference"

# A scene without lights is black, and says why: in the terminal and, in letters, on the screen.
mkdir nothing
xvfb-run -a -s '-screen 0 640x480x24' "$viewer" room.obj --light point:1,2.5,1:0,0,0 --texels-per-unit 16 --page-size 256 \
    --width 320 --height 240 --headless --frames 3 --screenshot-every 2 --out nothing >message 2>&1 || fail 'without light: it fails'
grep -q 'no light' message || fail "without light it says: $(cat message)"
[ "$(mean nothing/frame00002.png)" -gt 0 ] || fail 'without light the screen says nothing'

if "$viewer" room.obj --light lamp:1,2,3:4,5,6 2>message || ! grep -q 'lamp' message; then
    fail 'a wrong light is not named'
fi
if xvfb-run -a "$viewer" nothing.obj --headless --frames 1 >message 2>&1 || ! grep -q 'nothing.obj' message; then
    fail 'a file that is not there is not named'
fi
echo 'viewer: passed'
