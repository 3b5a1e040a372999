#!/usr/bin/env bash
# Builds the HTML manual: README.md, docs/ and what belongs to them by pandoc, include/bakelite.h by Doxygen. Names of the
# header that the documents mention lead to its pages.
#
#     docs/manual.sh [FOLDER]        default: target/manual; start with index.html
#
# Fails if a document links to what is not there, or if Doxygen warns.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-target/manual}
for tool in doxygen pandoc; do
    command -v $tool >/dev/null || {
        echo "There is no $tool: apt-get install doxygen pandoc" >&2
        exit 1
    }
done
rm -rf "$out"
mkdir -p "$out"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# ---- The header ----

{
    cat docs/Doxyfile
    echo "OUTPUT_DIRECTORY = $out"
    echo "HTML_OUTPUT = header"
    echo "GENERATE_TAGFILE = $work/header.tag"
} | doxygen -

# ---- The documents ----

pages='index:README.md guide:docs/guide.md install:docs/install.md performance:docs/performance.md accuracy:docs/accuracy.md
    architecture:docs/architecture.md robustness:docs/robustness.md experiments:docs/experiments.md
    contributing:CONTRIBUTING.md security:SECURITY.md changelog:CHANGELOG.md'
{
    echo '<nav>'
    for page in $pages; do
        name=${page%%:*}
        echo "<a href=\"$name.html\">${name/index/start}</a>"
        [ "$name" != guide ] || echo '<a href="header/topics.html">header</a>'
    done
    echo '</nav>'
} >"$work/nav.html"
# Doxygen renamed the list of groups.
[ -e "$out/header/topics.html" ] || sed -i 's|header/topics.html|header/modules.html|' "$work/nav.html"

for page in $pages; do
    name=${page%%:*}
    file=${page#*:}
    MANUAL_PAGES=$pages MANUAL_TAGS=$work/header.tag MANUAL_FILE=$file pandoc --from gfm --to html5 --standalone \
        --metadata "title=Bakelite: $(sed -n '1s/^# //p' "$file")" --lua-filter docs/manual/links.lua \
        --css manual.css --include-before-body "$work/nav.html" --output "$out/$name.html" "$file"
done
cp docs/manual/manual.css "$out"
cp benches/pictures/atrium.jpg LICENSE-APACHE LICENSE-MIT "$out"
echo "$out/index.html"
