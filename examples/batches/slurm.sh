#!/bin/sh
# A batch as arrays of Slurm: each stage begins when all tasks of the one before have ended, however they did.
#
#   examples/batches/slurm.sh bags/*.bag --store /shared/results --parts 4
#
# The arguments are those of `vidar plan`. Recordings and store are at the same paths on every node. CPUS (4) is the number of processors
# of a task, SBATCH_OPTIONS what else sbatch is to be told (partition, account, time). Running it again does only what is missing.
set -eu
CPUS=${CPUS:-4}
# shellcheck source=examples/batches/plan.sh
. "$(dirname "$0")/plan.sh"

after=
for stage in track predict map; do
    # shellcheck disable=SC2086
    job=$(sbatch --parsable --requeue --job-name "vidar-$stage" --cpus-per-task "$CPUS" --array "0-$(($(tasks $stage) - 1))" \
        ${after:+--dependency "afterany:$after"} ${SBATCH_OPTIONS:-} \
        --wrap "vidar work --plan '$PLAN' --stage $stage --index \$SLURM_ARRAY_TASK_ID --threads $CPUS -q")
    after=${job%%;*}
done
# shellcheck disable=SC2086
sbatch --parsable --job-name vidar-report --dependency "afterany:$after" ${SBATCH_OPTIONS:-} \
    --wrap "vidar work --plan '$PLAN' --stage report"
