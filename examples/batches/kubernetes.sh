#!/bin/sh
# A batch as indexed jobs of Kubernetes, one for each stage (kubernetes.yaml).
#
#   CLAIM=recordings examples/batches/kubernetes.sh /data/bags/*.bag --store /data/results --parts 4
#
# The arguments are those of `vidar plan`, which runs here: the volume CLAIM, a claim that many nodes may use, is mounted at MOUNT (/data) here
# and in the containers. IMAGE (vidar:latest) is built from the Containerfile. Running it again does only what is missing.
set -eu
IMAGE=${IMAGE:-vidar:latest} MOUNT=${MOUNT:-/data} CPUS=${CPUS:-4}
# shellcheck source=examples/batches/plan.sh
. "$(dirname "$0")/plan.sh"
template=$(dirname "$0")/kubernetes.yaml
# A job's name tells the plan, so that two batches do not meet.
hash=${PLAN##*/}
batch=$(printf %s "$hash" | cut -c1-8)

for stage in track predict map report; do
    job=vidar-$batch-$stage
    count=$(tasks $stage)
    kubectl delete job "$job" --ignore-not-found
    sed -e "s|@JOB@|$job|" -e "s|@STAGE@|$stage|" -e "s|@TASKS@|${count:-1}|g" -e "s|@PLAN@|$PLAN|" -e "s|@IMAGE@|$IMAGE|" \
        -e "s|@CPUS@|$CPUS|g" -e "s|@MOUNT@|$MOUNT|" -e "s|@CLAIM@|$CLAIM|" "$template" | kubectl apply -f -
    # Failed is also where some recordings failed: the rest of the batch goes on.
    until kubectl get job "$job" -o 'jsonpath={.status.conditions[?(@.status=="True")].type}' | grep -qE 'Complete|Failed'; do
        sleep 5
    done
done
kubectl logs "job/vidar-$batch-report"
