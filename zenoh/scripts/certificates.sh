#!/usr/bin/env bash
# Makes an authority of one's own, a certificate for the router, and one for each who may connect to it. By the name in it
# (CN) the router knows who it is.
#
# usage: certificates.sh FOLDER ROUTER NAME...
#   ROUTER is the name or the address by which the router is reached; NAME: gateway, archive, station, ...
# leaves: FOLDER/ca.pem, and for `router` and each NAME: NAME.pem and NAME.key. Keep ca.key and the other keys to yourself.
# environment: DAYS=365, for which they hold
# needs: openssl
set -euo pipefail
[ $# -ge 3 ] || { sed -n '2,9p' "$0" >&2; exit 2; }
folder=$1 router=$2
shift 2
mkdir -p "$folder"
cd "$folder"
umask 077
days=${DAYS:-365}

if [ ! -f ca.key ]; then
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout ca.key -out ca.pem -days "$days" \
        -subj "/CN=flockmap authority" -addext basicConstraints=critical,CA:TRUE -addext keyUsage=critical,keyCertSign 2> /dev/null
fi
case $router in
    *[!0-9.]*) place=DNS:$router ;;
    *) place=IP:$router ;;
esac

# A certificate: $1 its name, $2 what else is in it.
certificate() {
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout "$1.key" -out "$1.csr" -subj "/CN=$1" 2> /dev/null
    openssl x509 -req -in "$1.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days "$days" -out "$1.pem" \
        -extfile <(printf 'basicConstraints=CA:FALSE\nkeyUsage=digitalSignature\n%s\n' "$2") 2> /dev/null
    rm "$1.csr"
}
certificate router $'extendedKeyUsage=serverAuth,clientAuth\n'"subjectAltName=$place"
for name in "$@"; do
    certificate "$name" $'extendedKeyUsage=clientAuth\n'"subjectAltName=DNS:$name"
done
echo "in $PWD: ca.pem, router.pem and $*"
