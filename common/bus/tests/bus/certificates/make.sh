#!/bin/sh
# Makes the throwaway certificates of the network tests; they are worth nothing elsewhere.
set -e
cd "$(dirname "$0")"
openssl req -x509 -newkey ed25519 -nodes -days 36500 -subj "/CN=test authority" \
    -keyout authority.key -out authority.pem
printf 'subjectAltName=IP:127.0.0.1,DNS:localhost\n' > names
for name in rover operator viewer; do
    openssl req -newkey ed25519 -nodes -subj "/CN=$name" -keyout "$name.key" -out "$name.csr"
    openssl x509 -req -in "$name.csr" -CA authority.pem -CAkey authority.key -days 36500 \
        -extfile names -out "$name.pem"
done
rm -f names authority.key ./*.csr authority.srl
